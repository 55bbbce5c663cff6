"""From a camera's files to its ISP with a noise law, and how well an ISP reconstructs RAW."""
