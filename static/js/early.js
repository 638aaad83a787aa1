/** Connects as soon as the few modules that this needs are there, while the rest of the page is still being loaded. */

import { connectEarly } from "./net/connection.js";

connectEarly();
