"""`python docs/incidents_page.py` writes incidents.md: the table of incidents, within the text of
incidents.md.jinja.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2

from thirdhand.contract.incidents import INCIDENTS, Condition, Incident, filled, word
from thirdhand.contract.records import Mode
from thirdhand.settings.config import Settings

PAGE = Path(__file__).with_name("incidents.md")


def page() -> str:
    """The text of the page."""
    template = jinja2.Template(
        PAGE.with_suffix(".md.jinja").read_text(encoding="utf-8"), trim_blocks=True
    )
    return template.render(incidents=INCIDENTS, table=table) + "\n"


def table(rows: Sequence[Incident]) -> str:
    """Incidents as a Markdown table; with their modes if they decide any."""
    heads = [
        "mode" if isinstance(rows[0].member, Mode) else "incident",
        *(["mode"] if any(row.mode is not None for row in rows) else []),
    ]
    lines = [[*heads, "what happened", "what to do"], ["---"] * (len(heads) + 2)]
    for row in rows:
        mode = "" if row.mode is None else f"`{word(row.mode)}`"
        cells = [
            _name(row),
            *([mode] if len(heads) > 1 else []),
            filled(row.what_happened, Settings()),
            row.what_to_do,
        ]
        lines.append(cells)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _name(row: Incident) -> str:
    """The title of an incident, with its word in statuses and recordings if it has one."""
    is_named = row.member is Condition.MALFORMED or not isinstance(row.member, Condition)
    if isinstance(row.member, Mode):
        return f"`{word(row.member)}`"
    return f"{row.title} (`{word(row.member)}`)" if is_named else row.title


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
