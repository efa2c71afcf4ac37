"""Pages for people: the report of a campaign and the page of one sample, each one self-contained HTML file."""
