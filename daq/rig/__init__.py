"""The rig file: parsed, checked, edited in place."""
