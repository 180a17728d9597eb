// SIGINT and SIGTERM as a flag that the training loop asks; a second SIGINT ends at once.
#pragma once

namespace semfield::app {

void install_stop_signals();
/// 0, or the number of the signal received.
int stop_signal();

}  // namespace semfield::app
