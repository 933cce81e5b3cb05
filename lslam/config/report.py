"""Section `report`: what a run writes for people."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


class ReportConfig(Section):
    """The HTML report."""

    html: bool = Field(True, description="write report.html")
