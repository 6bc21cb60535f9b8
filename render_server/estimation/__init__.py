"""Estimates from pictures: the lights' registration, light from out of view, and albedo."""
