"""The browser view: what is drawn, the page it is drawn in, and what can be asked there."""
