"""Code in the text is a link where it names a thing of the API: `pdvc.measure.measure`, `pdvc/projection.py`."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode


class LinkedCode(SphinxPostTransform):
    """Wrap inline code in a link, unless it is one or part of one."""

    default_priority = 5

    def run(self, **_: Any) -> None:
        """Look each inline code up among the documented objects."""
        objects = self.env.domains.python_domain.objects
        for code in list(self.document.findall(nodes.literal)):
            text = code.astext()
            name = text[:-3].replace("/", ".") if text.endswith(".py") else text.removesuffix("()")
            found = objects.get(name)
            if found is None or "." not in name or found.docname == self.env.docname or _inside_link(code):
                continue
            link = make_refnode(self.app.builder, self.env.docname, found.docname, found.node_id, [code.deepcopy()])
            code.replace_self(link)


def _inside_link(node: nodes.Node | None) -> bool:
    while node is not None:
        if isinstance(node, nodes.reference | nodes.title) or node.tagname == "pending_xref":
            return True
        node = node.parent
    return False


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the transform."""
    app.add_post_transform(LinkedCode)
    return {"parallel_read_safe": True}
