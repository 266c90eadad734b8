"""The service: rig file, clock, ring, pipeline, log, viewer, reports, command line."""
