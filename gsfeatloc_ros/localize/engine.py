"""What localizes, made from the node's parameters: a map, a renderer, a matcher."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.localize.localizer import Localizer, LocalizerOptions
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import Matcher, create_matcher
from gsfeatloc_ros.node.parameters import Value, localizer_options, map_alignment
from gsfeatloc_ros.render import Renderer, create_renderer
from gsfeatloc_ros.render.cache import load_prepared


@dataclass(frozen=True, eq=False)
class Engine:
    """A localizer and what it is made of.

    Attributes:
        map_path: of the map's file.
        renderer: of the map.
        matcher: of features.
        options: of the localizer.
        localizer: of the three.
    """

    map_path: str
    renderer: Renderer
    matcher: Matcher
    options: LocalizerOptions
    localizer: Localizer

    def with_options(self, options: LocalizerOptions) -> Engine:
        """The same with other options."""
        return replace(self, options=options, localizer=Localizer(self.renderer, self.matcher, options))

    def with_map(self, values: dict[str, Value]) -> Engine:
        """The same with the map of `values`; raises as load_engine does."""
        renderer = _load_renderer(values)
        return replace(
            self,
            map_path=values["map.path"],
            renderer=renderer,
            localizer=Localizer(renderer, self.matcher, self.options),
        )


def load_engine(values: dict[str, Value]) -> Engine:
    """Load the map and the matcher, and compile and run all code once; takes seconds.

    Args:
        values: of all parameters by name.

    Raises:
        ValueError, OSError, RuntimeError: the parameters, the map or the matcher's weights cannot be used; the message
            says why.
    """
    options = localizer_options(values)
    renderer = _load_renderer(values)
    matcher = create_matcher(
        values["matcher.name"], values["matcher.weights"], values["matcher.max_features"], values["renderer.device"]
    )
    # Now, not at the first image: it takes long.
    warm_up(matcher, values["renderer.device"], values["renderer.threads"])
    return Engine(values["map.path"], renderer, matcher, options, Localizer(renderer, matcher, options))


def _load_renderer(values: dict[str, Value]) -> Renderer:
    if not values["map.path"]:
        raise ValueError("parameter map.path is empty: set it to a map file (-p map.path:=/path/to/map.ply)")
    load = load_prepared if values["map.cache"] else load_map
    return create_renderer(
        load(values["map.path"], map_alignment(values)),
        values["renderer.device"],
        values["renderer.threads"],
        sh_degree=values["renderer.sh_degree"],
        resolution_scale=values["renderer.resolution_scale"],
    )
