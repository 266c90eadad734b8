"""A link's name turned into a driver."""
