"""The Rerun viewer and recording."""
