"""Pure functions of arrays: score tests, corrections for many tests, spectra, whiteness."""
