"""Figures for people: call `page.write_report` for a run's page, `tables` for Markdown."""
