"""MQTT: what happens in the cell, reported to a plant's broker; nothing is obeyed from there."""
