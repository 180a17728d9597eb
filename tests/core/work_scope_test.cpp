// Settings of work: seen by the threads that help, by no other thread, and given back.
#include "core/work_scope.h"

#include <gtest/gtest.h>

#include <atomic>
#include <thread>

#include "compute/parallel.h"

namespace semfield {
namespace {

TEST(WorkScope, HelpersSeeItOtherThreadsDoNotAndItEnds) {
  const int before = thread_count();
  WorkSettings three;
  three.threads = 3;
  {
    const WorkScope scope(three);
    EXPECT_EQ(thread_count(), 3);
    std::atomic<int> others{0};
    parallel_for(1000, [&](std::int64_t) { others += &work_settings() == &three ? 0 : 1; });
    EXPECT_EQ(others, 0);
    int elsewhere = 0;
    std::thread([&] { elsewhere = thread_count(); }).join();
    EXPECT_EQ(elsewhere, before);
    {
      WorkSettings one;
      one.threads = 1;
      const WorkScope inner(one);
      EXPECT_EQ(thread_count(), 1);
    }
    EXPECT_EQ(thread_count(), 3);
    three.threads = 2;
    EXPECT_EQ(thread_count(), 2) << "borrowed, so a change is seen";
  }
  EXPECT_EQ(thread_count(), before);
}

}  // namespace
}  // namespace semfield
