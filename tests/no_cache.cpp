// Linked into every test program: tests neither read nor fill the user's cache, unless they say where theirs is.
#include <cstdlib>

namespace {
[[maybe_unused]] const int kSet = ::setenv("SEMFIELD_CACHE", "off", 0);
}  // namespace
