"""A page that shows a record in any browser: one HTML file with the cell in 3-D and its curves."""

from warpflag.view.page.document import notebook_frame, page_of, write_page

__all__ = ["notebook_frame", "page_of", "write_page"]
