"""Parts of a scene: links, tools, table, nut and peg."""
