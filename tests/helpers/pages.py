"""A page of ours as a browser's parser splits it."""

import json
from html.parser import HTMLParser


class Page(HTMLParser):
    """Rows of all tables, texts by the id or name of their element, and the names of all elements."""

    def __init__(self, path):
        super().__init__()
        self.rows, self.tags, self.texts = [], [], {}
        self._in = ""
        self.feed(path.read_text(encoding="utf-8"))

    @property
    def data(self):
        """What a report's scripts draw."""
        return json.loads(self.texts["data"])

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self._in = dict(attrs).get("id") or tag
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self._in = ""

    def handle_data(self, data):
        self.texts[self._in] = self.texts.get(self._in, "") + data
        if self._in in ("td", "th"):
            self.rows[-1][-1] += data
