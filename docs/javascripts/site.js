// Accessibility of what the theme makes in the browser: names for the toolbars of code, and wide tables that scroll by keyboard.
function improve() {
  for (const [index, toolbar] of document.querySelectorAll(".md-code__nav").entries())
    if (!toolbar.ariaLabel) toolbar.ariaLabel = `Tools of code block ${index + 1}`;
  for (const frame of document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])")) {
    frame.tabIndex = 0;
    frame.setAttribute("role", "group");
    frame.setAttribute("aria-label", "Table");
  }
}

improve();
new MutationObserver(improve).observe(document.body, { childList: true, subtree: true });
