"""From a run folder to something to look at: report, figures, scene, exports; reads logs, knows no flight."""
