"""Where a map's frame lies in the robot's: the similarity that the parameters map.* declare, estimated."""
