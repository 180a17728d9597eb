// What a process that ends by a signal still does about its files.
#pragma once

namespace semfield {

/// Removes the temporary files that this process is writing (AtomicFile). Async-signal-safe; nothing may be written
/// afterwards.
void remove_own_temporaries() noexcept;

}  // namespace semfield
