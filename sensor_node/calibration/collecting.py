"""Collecting views from a series of pictures; Ctrl-C ends a live series."""

from collections.abc import Callable
from contextlib import closing, suppress

from sensor_node.calibration.picture_sources import Series
from sensor_node.calibration.targets import Target
from sensor_node.calibration.views import ViewCollector

# More views do not improve a lens; the time of a fit grows with their cube.
MOST_VIEWS = 60


def collect_views(
    series: Series, target: Target, *, enough: int, tell: Callable[[ViewCollector, bool], None]
) -> ViewCollector:
    """Examine all pictures of a series, or a live camera's until there are `enough` views or Ctrl-C.

    Args:
        series: the pictures.
        target: what to look for.
        enough: views at which a live series ends.
        tell: called after each picture with the collector and whether the picture was taken as a view.
    """
    collector = ViewCollector(target, moving=series.moving)
    live = series.total is None
    # Closing releases a camera before the long fit begins.
    with suppress(*(KeyboardInterrupt,) if live else ()), closing(series.pictures):
        for picture in series.pictures:
            tell(collector, collector.add(picture))
            if live and len(collector.views) >= enough:
                break
    # Evenly over the series, so that none of its parts is lost.
    step = -(-len(collector.views) // MOST_VIEWS)
    collector.views = collector.views[:: max(step, 1)]
    return collector
