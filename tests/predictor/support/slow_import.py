"""Takes seconds to import, as large libraries do."""

import time

time.sleep(4.0)
