#include "core/spelling.h"

#include <algorithm>

#include "core/error.h"

namespace semfield {

namespace {

// Restricted Damerau-Levenshtein distance: one swap of neighbours counts as one slip, as typists make them.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::vector<std::size_t>> d(a.size() + 1, std::vector<std::size_t>(b.size() + 1));
  for (std::size_t i = 0; i <= a.size(); ++i) d[i][0] = i;
  for (std::size_t j = 0; j <= b.size(); ++j) d[0][j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t swap_cost = a[i - 1] == b[j - 1] ? 0 : 1;
      d[i][j] = std::min({d[i - 1][j] + 1, d[i][j - 1] + 1, d[i - 1][j - 1] + swap_cost});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
        d[i][j] = std::min(d[i][j], d[i - 2][j - 2] + 1);
    }
  }
  return d[a.size()][b.size()];
}

// The known name of the least distance, at most a third of the word's length.
template <class Distance>
std::string nearest(std::string_view word, const std::vector<std::string>& known, Distance&& distance_to) {
  std::string best;
  if (word.size() > 200) return best;  // no slip of the keyboard
  std::size_t best_distance = std::max<std::size_t>(1, word.size() / 3) + 1;
  for (const std::string& candidate : known) {
    const std::size_t distance = distance_to(candidate);
    if (distance < best_distance) {
      best_distance = distance;
      best = candidate;
    }
  }
  return best;
}

}  // namespace

std::string closest_spelling(std::string_view word, const std::vector<std::string>& known) {
  return nearest(word, known, [&](const std::string& candidate) { return edit_distance(word, candidate); });
}

std::string did_you_mean(std::string_view word, const std::vector<std::string>& known) {
  return nearest(word, known, [&](const std::string& candidate) {
    // A part of four letters in common also counts as near ('n_level' is far from 'levels' by edits alone).
    const std::size_t distance = edit_distance(word, candidate);
    const bool shared =
        word.size() >= 4 && candidate.find(word.substr(word.size() > 4 ? word.size() - 5 : 0)) != std::string::npos;
    return shared ? std::min<std::size_t>(distance, 2) : distance;
  });
}

}  // namespace semfield
