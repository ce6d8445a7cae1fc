"""Results as tables, figures and videos."""
