"""Files: Parquet tables with explicit schemas, images, COCO and SMPL JSON; all written atomically."""
