"""CAN frames in all their forms."""
