"""The page of a trend: numbers of a machine over months, with zoom and hover."""
