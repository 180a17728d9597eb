// What a part says of itself where it computes more slowly than it could.
#pragma once

#include <string>

namespace semfield {

/// A field may be one, beside Field<Real>: a run on a GPU asks its fields and warns.
class SlowPath {
 public:
  virtual ~SlowPath() = default;
  /// "runs layer by layer here; ...", what the fast way needs; "" where it is taken.
  virtual std::string slow_path() const = 0;
};

}  // namespace semfield
