"""Results for people: the HTML page, the terminal table, metrics."""
