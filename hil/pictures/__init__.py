"""From a run folder to pictures: report, figures, scene, exports; reads logs only."""
