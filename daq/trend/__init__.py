"""A machine watched for years: segments of its log, what is kept of them, the trend, alarms."""
