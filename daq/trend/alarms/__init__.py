"""Alarms: what is watched, when a change is one, who is told."""
