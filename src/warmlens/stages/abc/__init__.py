"""Stage `abc`: acceptance, bound and calibration."""
