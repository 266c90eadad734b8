"""A machine watched for years: segments of its log, their retention, the trend, alarms."""
