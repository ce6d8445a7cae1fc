// The controls that play recorded episodes on a stage.
(function () {
  "use strict";
  const ns = window.servotrack;
  const { h } = ns;
  const SPEEDS = [0.25, 0.5, 1, 2, 4];

  // A player of episodes. Returns its node and `stop`, to be called when the view is left.
  function player(label, replays, autoplay) {
    const { scene } = replays[0].replay, form = ns.stages.of(scene), canvases = form.make(label, scene), last = form.last(replays);
    let at = 0, playing = false, speed = 1, before = 0, frame = 0, gone = false;
    const time = h("span", { class: "clock" });
    const button = h("button", { type: "button", class: "play", onclick: () => (playing ? pause() : play()) });
    const slider = h("input", { type: "range", min: 0, max: last, step: 1, value: 0, "aria-label": "Instant of the episode", oninput: () => { pause(); at = Number(slider.value); draw(); } });
    const speeds = h("select", { "aria-label": "Speed", onchange: () => (speed = Number(speeds.value)) }, SPEEDS.map((value) => h("option", { value: String(value) }, `${value}×`)));
    speeds.value = "1";
    const controls = h("div", { class: "controls" }, button, slider, time, speeds);

    function draw() {
      form.show(canvases, replays, at);
      time.textContent = form.clock(scene, at);
      slider.value = at;
      slider.setAttribute("aria-valuetext", `${form.spokenTime(scene, at)}, ` + replays.map(({ replay, name }) => `${name} ${form.spoken(replay, at)}`).join(", "));
    }
    function tick(now) {
      if (gone) return;
      if (playing) {
        at = Math.min(at + (speed * Math.min(Math.max(now - before, 0), 100)) * form.rate(scene) / 1000, last);
        before = now;
        draw();
        if (at >= last) pause();
        else frame = requestAnimationFrame(tick);
      }
    }
    function play() {
      if (at >= last) at = 0;
      playing = true;
      before = performance.now();
      label_();
      frame = requestAnimationFrame(tick);
    }
    function pause() {
      playing = false;
      cancelAnimationFrame(frame);
      label_();
    }
    function label_() {
      button.textContent = playing ? "❚❚" : "▶";
      button.setAttribute("aria-label", playing ? "Pause" : "Play");
    }
    const keys = (event) => {
      if (event.target.closest("input, select, button, a, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") (playing ? pause() : play());
      else if (event.key === "ArrowRight" || event.key === "ArrowLeft") { pause(); at = Math.min(Math.max(Math.round(at) + (event.key === "ArrowRight" ? 1 : -1), 0), last); draw(); }
      else return;
      event.preventDefault();
    };
    document.addEventListener("keydown", keys);
    window.addEventListener("schemechange", draw);
    const observer = new ResizeObserver(draw);
    observer.observe(canvases.node);
    label_();
    if (autoplay && !ns.calm()) play();
    else at = Math.min(form.start(scene), last);
    return {
      node: h("div", { class: "player" }, canvases.node, controls),
      stop() {
        gone = true;
        cancelAnimationFrame(frame);
        observer.disconnect();
        document.removeEventListener("keydown", keys);
        window.removeEventListener("schemechange", draw);
      },
    };
  }

  ns.player = { player };
})();
