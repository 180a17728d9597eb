#include "app/serve/run_id.h"

#include <filesystem>
#include <optional>

#include "app/serve/page_access.h"
#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

struct Kept {
  std::string id, place;
};

// None: there is no such file, or it holds something else.
std::optional<Kept> kept_in(const fs::path& run_dir) {
  constexpr std::size_t kMostBytes = 8192;
  std::error_code unknown;
  const fs::path file = run_dir / "run_id";
  if (!fs::is_regular_file(file, unknown)) return std::nullopt;
  const std::string text = read_file_start(file.string(), kMostBytes);
  const std::size_t end = text.find('\n');
  if (end != 32 || text.find_first_not_of("0123456789abcdef") != end || !text.ends_with('\n')) return std::nullopt;
  return Kept{text.substr(0, end), text.substr(end + 1, text.size() - end - 2)};
}

bool is_copy(const Kept& kept, const fs::path& place) {
  std::error_code unknown;
  if (kept.place == place || fs::equivalent(kept.place, place, unknown)) return false;
  const std::optional<Kept> original = kept_in(kept.place);
  return original && original->id == kept.id;
}

}  // namespace

std::string kept_run_id(const std::string& run_dir) {
  const fs::path place = fs::weakly_canonical(fs::absolute(run_dir));
  std::optional<Kept> kept = kept_in(place);
  if (kept && kept->place == place) return kept->id;
  if (kept && is_copy(*kept, place)) {
    fs::remove(place / "serve_token");
    kept.reset();
  }
  const std::string id = kept ? kept->id : new_token();
  write_file_atomic((place / "run_id").string(), id + "\n" + place.string() + "\n");
  return id;
}

}  // namespace semfield::app
