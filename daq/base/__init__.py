"""Base of the service: what every other room needs."""
