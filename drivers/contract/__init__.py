"""The driver contract: readings, notices, errors, the link base class."""
