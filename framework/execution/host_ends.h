// Host memory at both ends of a call on a device.
#pragma once

#include <type_traits>

#include "core/workspace.h"
#include "model/stages.h"

namespace semfield {

/// Rows as bytes, as Stages::copy takes them.
template <class T>
auto bytes_of(View<T> rows) {
  using Byte = std::conditional_t<std::is_const_v<T>, const std::byte, std::byte>;
  return View<Byte>(reinterpret_cast<Byte*>(rows.data), rows.rows, rows.cols * static_cast<std::int32_t>(sizeof(T)),
                    rows.row_stride * static_cast<std::int64_t>(sizeof(T)), rows.device);
}

/// Host views of a call as the stages see them: themselves, or copies in the device's memory.
template <class Real>
struct HostEnds {
  const Stages<Real>& stages;
  Workspace& arena;

  template <class T>
  View<const T> sent(View<const T> from) const {
    if (from.empty() || stages.host_memory) return from;
    const View<T> to = arena.take<T>(from.rows, from.cols);
    stages.copy(bytes_of(from), bytes_of(to));
    return to;
  }
  template <class T>
  View<T> room_for(View<T> wanted) const {
    return wanted.empty() || stages.host_memory ? wanted : arena.take<T>(wanted.rows, wanted.cols);
  }
  template <class From, class T>
  void fetch(View<From> from, View<T> wanted) const {
    if (!wanted.empty() && wanted.data != from.data) stages.copy(bytes_of(View<const T>(from)), bytes_of(wanted));
  }
};

}  // namespace semfield
