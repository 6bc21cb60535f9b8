"""Ground truth: "real" rooms rendered with Mitsuba 3 as cameras and depth sensors see them (docs/method.md 8)."""
