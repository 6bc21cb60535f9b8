"""Estimates from what a picture shows: scale of the lights, planes beyond the border, light out of sight."""
