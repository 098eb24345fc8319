"""What may be claimed of a study: diagnosis, its checks, partial explanations, doubts."""
