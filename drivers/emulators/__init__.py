"""Programs that speak the devices' own protocols to the real drivers."""
