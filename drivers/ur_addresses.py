"""TCP ports of a UR controller, and one of the emulator's own for faults."""

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT, FAULT_PORT = 30004, 30003, 29999, 39999
