"""HTML pages: one file that shows a model in any browser with WebGL2, without a network."""
