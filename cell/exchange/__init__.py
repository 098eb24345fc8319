"""Models for other programs, and back: MuJoCo's XML, and a plain description as JSON."""
