"""Contents of the residual force of a fitted model: predictable parts, lines, impact trains, a faulty force path."""
