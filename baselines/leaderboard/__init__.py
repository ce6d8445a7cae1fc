"""From results to tables, figures, a page and a video."""
