"""Who watches a run: report, web page, Foxglove, video. The runtime does not know them."""
