"""Numbers from records: disturbances, the fit of a record, the rolling estimate."""
