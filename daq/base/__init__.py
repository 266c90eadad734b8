"""What every other room of the service needs."""
