"""A localizer made from settings: the same builders serve the node, replay, the evaluation and the benchmark."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings, RendererSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import Matcher, create_matcher
from gsfeatloc_ros.render import DrawOptions, Renderer, create_renderer
from gsfeatloc_ros.render.cache import load_prepared


@dataclass(frozen=True, eq=False)
class Engine:
    """A localizer and what it is made of.

    Attributes:
        map_path: of the map's file.
        renderer: of the map.
        matcher: of features.
        options: of the localizer.
        index: of views of the map; None where there is none.
    """

    map_path: str
    renderer: Renderer
    matcher: Matcher
    options: LocalizerOptions
    index: ViewIndex | None = None

    @cached_property
    def localizer(self) -> Localizer:
        """The localizer."""
        return Localizer(self.renderer, self.matcher, self.options, index=self.index)

    def with_options(self, options: LocalizerOptions) -> Engine:
        """Return the same with other options."""
        return replace(self, options=options)

    def with_map(self, map_path: str, renderer: Renderer) -> Engine:
        """Return the same with another map, of which there is no index yet."""
        return replace(self, map_path=map_path, renderer=renderer, index=None)

    def with_index(self, index: ViewIndex | None) -> Engine:
        """Return the same with an index of views of the map."""
        return replace(self, index=index)


def load_renderer(
    map_: MapSettings, renderer: RendererSettings, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Renderer:
    """Load a map and make its renderer.

    Args:
        map_: which map.
        renderer: how it is drawn.
        background: RGB in [0, 1] behind the map.

    Raises:
        ValueError, OSError, RuntimeError: the settings or the map cannot be used; the message says why.
    """
    if not map_.path:
        raise ValueError("parameter map.path is empty: set it to a map file (-p map.path:=/path/to/map.ply)")
    load = load_prepared if map_.cache else load_map
    return create_renderer(
        load(map_.path, map_.alignment(), map_.reading),
        renderer.device,
        renderer.threads,
        DrawOptions(background, renderer.sh_degree, renderer.resolution_scale),
    )


def load_matcher(matcher: MatcherSettings, device: str) -> Matcher:
    """Make a matcher on a device (Renderer.device); raise ValueError or RuntimeError where it cannot be had."""
    return create_matcher(matcher.name, matcher.weights, matcher.max_features, device)


def load_engine(
    map_: MapSettings, matcher: MatcherSettings, renderer: RendererSettings, options: LocalizerOptions
) -> Engine:
    """Load the map and the matcher, and compile and run all code once; takes seconds.

    Raises:
        ValueError, OSError, RuntimeError: the settings, the map or the matcher's weights cannot be used; the message
            says why.
    """
    map_renderer = load_renderer(map_, renderer)
    loaded = load_matcher(matcher, map_renderer.device)
    # Now, not at the first image: it takes long.
    warm_up(loaded, renderer.device, renderer.threads)
    return Engine(map_.path, map_renderer, loaded, options)
