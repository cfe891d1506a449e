"""Makes pictures from a run folder: report, figures, scene, exports; reads only logs."""
