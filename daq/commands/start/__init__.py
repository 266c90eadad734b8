"""A first rig file: from an example, a data file, a log, a DBC, or a few questions."""
