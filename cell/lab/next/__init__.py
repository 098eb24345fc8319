"""Next steps after a finding: advice, the most informative motion, discovery of laws."""
