"""How laws are compiled, placed, sized and written."""
