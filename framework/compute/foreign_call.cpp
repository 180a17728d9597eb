#include "compute/foreign_call.h"

#include <malloc.h>

#include <cstdlib>
#include <new>
#include <utility>

namespace semfield {

namespace {

thread_local KeptBlocks* blocks_of_call = nullptr;

}  // namespace

KeptBlocks::~KeptBlocks() {
  for (Block* block : first_) {
    while (block != nullptr) std::free(std::exchange(block, block->next));
  }
}

void* KeptBlocks::take(std::size_t bytes) {
  const std::size_t size = bytes / kStep;
  if (size >= first_.size() || first_[size] == nullptr) return nullptr;
  return std::exchange(first_[size], first_[size]->next);
}

bool KeptBlocks::keep(void* memory) {
  const std::size_t size = malloc_usable_size(memory) / kStep;
  if (size == 0 || size >= first_.size()) return false;
  first_[size] = new (memory) Block{first_[size]};
  return true;
}

ForeignCall::ForeignCall(KeptBlocks& blocks) { blocks_of_call = &blocks; }
ForeignCall::~ForeignCall() { blocks_of_call = nullptr; }
KeptBlocks* ForeignCall::blocks() { return blocks_of_call; }

}  // namespace semfield
