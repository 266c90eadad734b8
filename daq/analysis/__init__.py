"""What a record answers, as the JSON documents that commands write."""
