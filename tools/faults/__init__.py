"""Faults and endurance: devices that fail, processes that are killed, hundreds of cycles."""
