// What a parallel loop calls, borrowed.
#pragma once

#include <cstdint>
#include <memory>
#include <type_traits>

namespace semfield {

/// A borrowed callable void(std::int64_t): refers to the one it was made from and owns nothing, so passing a lambda
/// allocates nothing, whatever it captures. Valid while that callable lives.
class IndexBody {
 public:
  template <class Body, std::enable_if_t<!std::is_same_v<std::remove_cvref_t<Body>, IndexBody>, int> = 0>
  IndexBody(Body&& body)  // NOLINT(google-explicit-constructor): lambdas are passed as they stand
      : object_(const_cast<void*>(static_cast<const void*>(std::addressof(body)))),
        call_([](void* object, std::int64_t i) { (*static_cast<std::remove_reference_t<Body>*>(object))(i); }) {}
  void operator()(std::int64_t i) const { call_(object_, i); }

 private:
  void* object_;
  void (*call_)(void*, std::int64_t);
};

}  // namespace semfield
