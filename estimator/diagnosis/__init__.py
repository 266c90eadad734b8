"""Model against measurement, the effects on trial, and the verdict."""
