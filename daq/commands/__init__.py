"""What a user types: the body of each command."""
