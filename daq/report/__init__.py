"""What a person looks at: the HTML page, the terminal table, metrics."""
