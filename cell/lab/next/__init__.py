"""The next measurement: advice, suggested motions, power of a diagnosis, discovered laws."""
