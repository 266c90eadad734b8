"""Output of a command, files written whole, signals, memory."""
