#include "core/workspace.h"

#include <algorithm>

namespace semfield {

namespace {

constexpr std::size_t kAlign = 64;
constexpr std::size_t kSourceAlign = 256;
constexpr std::size_t kMinBlock = std::size_t{1} << 20;
std::size_t rounded(std::size_t bytes, std::size_t align) { return (bytes + align - 1) / align * align; }

// A thread's own, so that two sessions in two threads do not meet here.
thread_local const WorkSettings* t_settings = nullptr;

}  // namespace

Workspace::~Workspace() { clear_blocks(); }

void Workspace::clear_blocks() {
  if (source_.release != nullptr) {
    for (const Block& block : blocks_) source_.release(block.begin);
  }
  blocks_.clear();
  block_ = used_ = 0;
}

void Workspace::forget() {
  clear_blocks();
  high_water_ = 0;
}

void Workspace::reserve(std::size_t bytes) {
  if (bytes == 0 || (blocks_.size() == 1 && blocks_.front().bytes >= bytes)) return;
  clear_blocks();
  add_block(std::max(kMinBlock, merged_bytes(bytes)));
}

void Workspace::add_block(std::size_t bytes) {
  Block block;
  block.bytes = rounded(bytes, kSourceAlign);
  if (source_.allocate != nullptr) {
    block.begin = source_.allocate(block.bytes);
  } else {
    block.memory = std::make_unique_for_overwrite<std::byte[]>(block.bytes + kAlign);
    const auto address = reinterpret_cast<std::uintptr_t>(block.memory.get());
    block.begin = block.memory.get() + (kAlign - address % kAlign) % kAlign;
  }
  blocks_.push_back(std::move(block));
  ++growths_;
}

// Twice the last block, or where that is not to be had what is needed.
void Workspace::grow(std::size_t need) {
  const std::size_t wanted = std::max(need, 2 * blocks_[block_].bytes);
  try {
    add_block(wanted);
  } catch (...) {
    if (wanted == need) throw;
    add_block(need);
  }
}

std::byte* Workspace::take_bytes(std::size_t bytes) {
  const std::size_t need =
      rounded(std::max<std::size_t>(bytes, 1), source_.allocate != nullptr ? kSourceAlign : kAlign);
  if (blocks_.empty()) add_block(std::max({need, kMinBlock, merged_bytes(high_water_)}));
  while (used_ + need > blocks_[block_].bytes) {
    if (block_ + 1 == blocks_.size()) grow(need);
    ++block_;
    used_ = 0;
  }
  std::byte* result = blocks_[block_].begin + used_;
  used_ += need;
  total_ += need;
  high_water_ = std::max(high_water_, total_);
  return result;
}

void Workspace::release(std::size_t block, std::size_t used, std::size_t total) {
  block_ = block;
  used_ = used;
  total_ = total;
  if (total_ > 0 || blocks_.size() <= 1) return;
  clear_blocks();
  try {
    add_block(merged_bytes(high_water_));
  } catch (...) {
    // The end of a Scope cannot refuse: the next take asks again, and tells.
  }
}

// One block of the whole high-water mark in place of a chain, with room for the waste at block ends.
std::size_t Workspace::merged_bytes(std::size_t high_water) noexcept { return high_water + high_water / 8; }

std::size_t Workspace::reserved_bytes() const noexcept {
  std::size_t sum = 0;
  for (const Block& block : blocks_) sum += block.bytes;
  return sum;
}

const WorkSettings& work_settings() {
  static const WorkSettings defaults;
  return t_settings != nullptr ? *t_settings : defaults;
}

WorkScope::WorkScope(const WorkSettings& settings) : before_(t_settings) { t_settings = &settings; }
WorkScope::~WorkScope() { t_settings = before_; }

}  // namespace semfield
