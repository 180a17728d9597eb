// How far the opening of a scene is, for whoever shows it.
#pragma once

#include <cstddef>
#include <functional>
#include <string_view>

namespace semfield {

/// `doing` is "checking" (files, by their headers), "reading", "looking for the bounds" (a probe), or "read" at the end.
using LoadProgress = std::function<void(std::string_view doing, std::size_t done, std::size_t total)>;

/// Who is told in this process; nobody until this is called, which is to happen before a scene is opened.
void set_load_progress(LoadProgress progress);
/// From any thread; one call is passed on at a time.
void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total);

}  // namespace semfield
