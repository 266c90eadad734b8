"""A rig in time: what its sensors would send, deterministic by seed."""
