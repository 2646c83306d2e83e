"""Measurements: functions that return rows of a table."""
