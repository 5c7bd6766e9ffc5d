# SPDX-License-Identifier: Apache-2.0
"""The viewer: a page in the browser that shows a run, after it and during it, and edits its objects.

What is shown, picked and edited is known without any page (``edit_session``, ``picking``, ``colours``,
``thumbnails``); ``page`` and its panels show it by viser, which ``pip install 'ggwarp[viewer]'`` brings.
"""
