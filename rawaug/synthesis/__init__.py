"""RAW pairs on disk, made from a folder of sRGB pictures: files or shards, in parallel, each made once."""
