"""Ground truth: a "real" room rendered with Mitsuba 3 as cameras and depth sensors would see it (METHOD 8)."""
