"""Answers of a record, as the JSON documents that commands write."""
