"""From obstacles to the ellipsoids that enclose them, dilated by the tool."""
