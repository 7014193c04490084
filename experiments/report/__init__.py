"""The report's parts: charts, tables, sections, the interactive replay, the page around them."""
