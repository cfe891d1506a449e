"""Makes pictures and other files from a run folder: report, figures, scene, recording, exports; reads only logs."""
