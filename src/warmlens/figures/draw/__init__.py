"""Figures: functions that draw on an Axes."""
