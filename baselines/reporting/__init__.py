"""Building blocks of tables, pages and films. No result depends on this room."""
