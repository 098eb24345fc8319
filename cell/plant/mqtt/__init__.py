"""MQTT: reports the cell's events to a plant's broker; takes no commands from there."""
