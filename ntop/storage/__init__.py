"""Files: Parquet tables with explicit schemas, images, COCO and SMPL JSON; written atomically."""
