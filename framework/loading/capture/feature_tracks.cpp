#include "loading/capture/feature_tracks.h"

#include <algorithm>
#include <cstring>
#include <map>
#include <memory>
#include <numeric>
#include <unordered_map>

#include "core/error.h"

#ifdef SEMFIELD_WITH_IMAGES
#include <sqlite3.h>
#endif

namespace semfield {

#ifdef SEMFIELD_WITH_IMAGES

namespace {

constexpr std::int64_t kPairBase = 2147483647;  // pair_id = kPairBase * smaller id + larger id

struct Closer {
  void operator()(sqlite3* base) const { sqlite3_close(base); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};

class Database {
 public:
  explicit Database(const std::string& file) : file_(file) {
    sqlite3* opened = nullptr;
    const int code = sqlite3_open_v2(file.c_str(), &opened, SQLITE_OPEN_READONLY, nullptr);
    base_.reset(opened);
    if (code != SQLITE_OK) fail();
  }
  /// Calls `row(statement)` for each row.
  template <class Row>
  void each(const char* query, const Row& row) {
    sqlite3_stmt* prepared = nullptr;
    if (sqlite3_prepare_v2(base_.get(), query, -1, &prepared, nullptr) != SQLITE_OK) fail();
    const std::unique_ptr<sqlite3_stmt, Closer> statement(prepared);
    for (;;) {
      const int code = sqlite3_step(prepared);
      if (code == SQLITE_DONE) return;
      if (code != SQLITE_ROW) fail();
      row(prepared);
    }
  }
  [[noreturn]] void fail() const {
    throw Error(ErrorKind::data, "capture.database",
                "COLMAP's database '" + file_ + "' cannot be read: " + sqlite3_errmsg(base_.get()),
                "remove the file; the same command makes it again");
  }

 private:
  std::string file_;
  std::unique_ptr<sqlite3, Closer> base_;
};

// Rows of `cols` numbers of a blob in column `at`; empty where it does not hold them.
template <class T>
std::vector<T> numbers(sqlite3_stmt* row, int at, std::int64_t count) {
  const void* data = sqlite3_column_blob(row, at);
  const auto bytes = static_cast<std::size_t>(sqlite3_column_bytes(row, at));
  if (count <= 0 || data == nullptr || bytes != static_cast<std::size_t>(count) * sizeof(T)) return {};
  std::vector<T> out(static_cast<std::size_t>(count));
  std::memcpy(out.data(), data, bytes);
  return out;
}

// Sets of features, each with the frames that it has a feature of.
class Joined {
 public:
  explicit Joined(std::size_t count) : parent_(count), frames_(count) { std::iota(parent_.begin(), parent_.end(), 0u); }
  void set_frame(std::size_t feature, std::int32_t frame) { frames_[feature] = {frame}; }
  std::size_t root(std::size_t i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }
  void join(std::size_t a, std::size_t b) {
    a = root(a);
    b = root(b);
    if (a == b) return;
    std::vector<std::int32_t> both;
    std::set_union(frames_[a].begin(), frames_[a].end(), frames_[b].begin(), frames_[b].end(),
                   std::back_inserter(both));
    if (both.size() < frames_[a].size() + frames_[b].size()) return;
    if (frames_[a].size() < frames_[b].size()) std::swap(a, b);
    parent_[b] = static_cast<std::uint32_t>(a);
    frames_[a] = std::move(both);
    frames_[b] = {};
  }

 private:
  std::vector<std::uint32_t> parent_;
  std::vector<std::vector<std::int32_t>> frames_;
};

}  // namespace

std::vector<Track> feature_tracks(const std::string& file, const std::vector<std::string>& names) {
  Database database(file);
  std::map<std::string, std::int32_t> place;
  for (std::size_t i = 0; i < names.size(); ++i) place[names[i]] = static_cast<std::int32_t>(i);
  std::map<std::int64_t, std::int32_t> frame_of;  // by COLMAP's id
  database.each("SELECT image_id, name FROM images", [&](sqlite3_stmt* row) {
    const auto* name = reinterpret_cast<const char*>(sqlite3_column_text(row, 1));
    if (const auto found = place.find(name == nullptr ? "" : name); found != place.end())
      frame_of[sqlite3_column_int64(row, 0)] = found->second;
  });
  std::vector<Sighting> features;
  std::map<std::int64_t, std::pair<std::size_t, std::size_t>> range;  // first feature and number of each id
  database.each("SELECT image_id, rows, cols, data FROM keypoints ORDER BY image_id", [&](sqlite3_stmt* row) {
    const std::int64_t id = sqlite3_column_int64(row, 0), rows = sqlite3_column_int64(row, 1),
                       cols = sqlite3_column_int64(row, 2);
    const auto found = frame_of.find(id);
    if (found == frame_of.end() || cols < 2 || rows < 0 || rows > 1000000 || cols > 16) return;
    const std::vector<float> values = numbers<float>(row, 3, rows * cols);
    range[id] = {features.size(), values.size() / static_cast<std::size_t>(cols)};
    for (std::size_t i = 0; i < values.size(); i += static_cast<std::size_t>(cols))
      features.push_back({found->second, static_cast<double>(values[i]), static_cast<double>(values[i + 1])});
  });
  struct Matches {
    std::size_t a, b;  // first features
    std::vector<std::uint32_t> pairs;
  };
  std::vector<Matches> all;
  database.each("SELECT pair_id, rows, cols, data FROM two_view_geometries ORDER BY pair_id", [&](sqlite3_stmt* row) {
    const std::int64_t id = sqlite3_column_int64(row, 0), rows = sqlite3_column_int64(row, 1),
                       cols = sqlite3_column_int64(row, 2);
    const auto a = range.find(id / kPairBase), b = range.find(id % kPairBase);
    if (a == range.end() || b == range.end() || rows <= 0 || rows > 1000000 || cols != 2) return;
    Matches found{a->second.first, b->second.first, numbers<std::uint32_t>(row, 3, rows * cols)};
    for (std::size_t i = 0; i < found.pairs.size(); i += 2) {
      if (found.pairs[i] >= a->second.second || found.pairs[i + 1] >= b->second.second) return;
    }
    all.push_back(std::move(found));
  });
  // Pairs that share most are joined first: they are the surest.
  std::stable_sort(all.begin(), all.end(),
                   [](const Matches& x, const Matches& y) { return x.pairs.size() > y.pairs.size(); });
  Joined joined(features.size());
  for (std::size_t i = 0; i < features.size(); ++i) joined.set_frame(i, features[i].frame);
  for (const Matches& pair : all) {
    for (std::size_t i = 0; i < pair.pairs.size(); i += 2)
      joined.join(pair.a + pair.pairs[i], pair.b + pair.pairs[i + 1]);
  }
  std::unordered_map<std::size_t, std::size_t> track_of;
  std::vector<Track> out;
  for (std::size_t i = 0; i < features.size(); ++i) {
    const auto [at, fresh] = track_of.emplace(joined.root(i), out.size());
    if (fresh) out.emplace_back();
    out[at->second].seen.push_back(features[i]);
  }
  std::erase_if(out, [](const Track& track) { return track.seen.size() < 2; });
  return out;
}

#else

std::vector<Track> feature_tracks(const std::string&, const std::vector<std::string>&) {
  throw Error(ErrorKind::unavailable, "build.images.off", "this build does not read COLMAP's database",
              "build with SEMFIELD_WITH_IMAGES=ON");
}

#endif

}  // namespace semfield
