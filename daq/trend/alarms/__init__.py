"""Alarms: watched values, the rules for an alarm, and its listeners."""
