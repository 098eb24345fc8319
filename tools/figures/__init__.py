"""What pages show: pictures, drawings, and the reference of checks."""
