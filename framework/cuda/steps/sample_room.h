// Room for the samples of a step on a device, where a sampler leaves most of what there can be unused.
#pragma once

#include <cstdint>

namespace semfield::cuda {

/// A step's arrays have a row for every sample that there can be, and every kernel passes over all of them. So steps
/// get room for a quarter more samples than those before them had. A step that had more is made again with room for all
/// (Stage::room).
class SampleRoom {
 public:
  /// most: samples that there can be; 0: room is never less than that.
  void begin(std::int64_t most) { most_ = most, rows_ = 0; }
  /// 0: for all.
  std::int64_t rows() const { return rows_; }
  void give_all() { rows_ = 0; }
  /// From the next step whose graph is not captured yet; for tests.
  void give(std::int64_t rows) { rows_ = rows; }
  /// What steps used at most. Returns whether the room is another one now.
  bool saw(std::int64_t samples);

 private:
  std::int64_t most_ = 0, rows_ = 0;
};

}  // namespace semfield::cuda
