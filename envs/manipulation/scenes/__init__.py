"""What stands in a scene: links, tools, table, nut and peg."""
