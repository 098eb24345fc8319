"""The search over sets of effects; sets fitted to a study, each once, screened and compared."""
