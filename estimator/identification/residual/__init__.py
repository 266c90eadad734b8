"""What the residual force of a fitted model holds: predictable parts, lines, impact trains, a faulty measured path."""
