"""The same fit while samples arrive."""
