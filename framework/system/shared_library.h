// Libraries of ours that are loaded when they are needed: they lie beside the framework's own and bring large
// dependencies that most runs do without.
#pragma once

#include <string>

namespace semfield {

/// The symbol of library `file` in the folder of the framework's library. Throws Error(unavailable): "<what>: <the
/// loader's words>"; `remedy` as in Error.
void* library_symbol(const std::string& file, const char* symbol, const std::string& what, const std::string& remedy);

/// The same of `target`, a library lib<target>.so that a build of the program alone leaves out; the remedy names the
/// target that builds it.
void* part_symbol(const std::string& target, const char* symbol, const std::string& what);

}  // namespace semfield
