"""Devices of others by a DBC, and recorded CAN traffic."""
