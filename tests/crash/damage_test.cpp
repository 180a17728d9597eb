// Files that rot: 10,000 single bits flipped and 1,000 lengths cut, of checkpoints and of packed scenes. All are
// noticed, with the file's name, and a run goes on from the checkpoint before. (G09, G10)
#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>

#include "core/rng.h"
#include "loading/packed_scene.h"
#include "run/checkpoint_store.h"
#include "system/files.h"
#include "tests/crash/scenarios.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_crash {
namespace {

namespace fs = std::filesystem;
constexpr int kFlips = 10'000, kCuts = 1'000;

std::uint64_t draw(std::uint32_t stream, int index, std::uint64_t below) {
  const float u = uniform01({31, 0, stream}, static_cast<std::uint64_t>(index));
  return std::min(below - 1, static_cast<std::uint64_t>(static_cast<double>(u) * static_cast<double>(below)));
}

// A file whose bytes are changed in place, without the cost of writing all of it 10,000 times.
class Victim {
 public:
  explicit Victim(std::string path) : path_(std::move(path)), bytes_(read_text_file(path_)) {
    file_ = open(path_.c_str(), O_WRONLY | O_CLOEXEC);
  }
  Victim(const Victim&) = delete;
  Victim& operator=(const Victim&) = delete;
  ~Victim() { close(file_); }
  std::uint64_t bits() const { return 8 * bytes_.size(); }
  std::uint64_t size() const { return bytes_.size(); }
  void flip(std::uint64_t bit) const { put(bit / 8, static_cast<char>(bytes_[bit / 8] ^ (1 << (bit % 8)))); }
  void restore(std::uint64_t bit) const { put(bit / 8, bytes_[bit / 8]); }
  void cut(std::uint64_t size) const { ASSERT_EQ(ftruncate(file_, static_cast<off_t>(size)), 0); }
  void restore_all() const {
    ASSERT_EQ(pwrite(file_, bytes_.data(), bytes_.size(), 0), static_cast<ssize_t>(bytes_.size()));
  }
  const std::string& path() const { return path_; }

 private:
  void put(std::uint64_t at, char byte) const { ASSERT_EQ(pwrite(file_, &byte, 1, static_cast<off_t>(at)), 1); }
  std::string path_, bytes_;
  int file_ = -1;
};

struct Noticed {
  int tried = 0, noticed = 0, named = 0;
};

// `read` returns the message of the damage, "" when it saw none.
template <class Read>
Noticed damage(const Victim& file, Read&& read) {
  Noticed seen;
  const auto note = [&](const std::string& message) {
    ++seen.tried;
    seen.noticed += message.empty() ? 0 : 1;
    seen.named += message.find(file.path()) != std::string::npos ? 1 : 0;
  };
  for (int i = 0; i < kFlips; ++i) {
    // The first rounds go through the head of the file bit by bit, where the lengths stand; the rest is drawn.
    const std::uint64_t bit = i < 1'000 ? static_cast<std::uint64_t>(i) : draw(1, i, file.bits());
    file.flip(bit);
    note(read());
    file.restore(bit);
  }
  for (int i = 0; i < kCuts; ++i) {
    file.cut(draw(2, i, file.size()));
    note(read());
    file.restore_all();
  }
  return seen;
}

class Damage : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = (fs::temp_directory_path() / "semfield_damage_XXXXXX").string();
    ASSERT_NE(mkdtemp(folder_.data()), nullptr);
  }
  void TearDown() override {
    std::error_code ignored;
    fs::remove_all(folder_, ignored);
  }
  std::string folder_;
};

TEST_F(Damage, OfACheckpointIsNoticedAndTheOneBeforeUsed) {
  prepare(Save::first, folder_);
  CheckpointStore store(folder_ + "/checkpoints");
  for (const int step : {100, 200}) {
    std::vector<float> values(300, static_cast<float>(step));
    store.save(step, {tensor_ref("main/field/hidden_0/weight", {10, 30}, values)}, {{"step", std::to_string(step)}});
  }
  const Victim file(folder_ + "/checkpoints/" + CheckpointStore::file_name(200));
  int went_back = 0;
  const Noticed seen = damage(file, [&]() -> std::string {
    Diagnostics diagnostics;
    const auto found = store.find_latest(diagnostics);
    went_back += found && found->step == 100 ? 1 : 0;
    return diagnostics.all().empty() ? std::string() : diagnostics.all().front().text();
  });
  EXPECT_EQ(seen.tried, kFlips + kCuts);
  EXPECT_EQ(seen.noticed, seen.tried);
  EXPECT_EQ(seen.named, seen.tried);
  EXPECT_EQ(went_back, seen.tried);
  Diagnostics diagnostics;
  EXPECT_EQ(store.find_latest(diagnostics)->step, 200) << "the control: undamaged, it is taken";
  std::printf("checkpoint of %llu bytes: %d of %d damages noticed\n", static_cast<unsigned long long>(file.size()),
              seen.noticed, seen.tried);
}

TEST_F(Damage, OfAPackedSceneIsNoticed) {
  prepare(Save::scene, folder_);
  const Victim file(folder_ + "/room.sfpack");
  const auto read = [&]() -> std::string {
    return testing_room::error_of([&] {
      const PackedScene scene(file.path());
      FrameBuffer buffer;
      for (std::size_t i = 0; i < scene.info().frames.size(); ++i) scene.read(static_cast<int>(i), buffer);
    });
  };
  EXPECT_EQ(read(), "") << "the control: undamaged, it is read";
  const Noticed seen = damage(file, read);
  EXPECT_EQ(seen.tried, kFlips + kCuts);
  EXPECT_EQ(seen.noticed, seen.tried);
  EXPECT_EQ(seen.named, seen.tried);
  std::printf("packed scene of %llu bytes: %d of %d damages noticed\n", static_cast<unsigned long long>(file.size()),
              seen.noticed, seen.tried);
}

}  // namespace
}  // namespace semfield::testing_crash
