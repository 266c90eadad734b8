"""Gates, the verdict of a diagnosis, and the ladder of improvements."""
