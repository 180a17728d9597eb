// Libraries of ours that are loaded when they are needed: they lie beside the framework's own and bring large
// dependencies that most runs do without.
#pragma once

#include <string>

namespace semfield {

/// The symbol of library `file` in the folder of the framework's library. Throws Error(unavailable): "<what>: <the
/// loader's words>"; `remedy` as in Error.
void* library_symbol(const std::string& file, const char* symbol, const std::string& what, const std::string& remedy);

}  // namespace semfield
