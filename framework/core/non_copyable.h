// What is not copied.
#pragma once

namespace semfield {

/// Base of what is neither copied nor moved, unless it says how it is moved.
struct NonCopyable {
  NonCopyable() = default;
  NonCopyable(const NonCopyable&) = delete;
  NonCopyable& operator=(const NonCopyable&) = delete;
};

}  // namespace semfield
