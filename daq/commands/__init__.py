"""The commands that a user types: the body of each."""
