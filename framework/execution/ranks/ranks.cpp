#include "execution/ranks/ranks.h"

#include <optional>

namespace semfield {

std::vector<std::string> texts_of(Ranks& ranks, const std::string& mine) {
  const std::vector<std::size_t> sizes = all_of(ranks, mine.size());
  std::size_t total = 0;
  for (const std::size_t size : sizes) total += size;
  std::string all(total, '\0');
  ranks.all_gather(std::as_bytes(std::span(mine)), std::as_writable_bytes(std::span(all)), sizes);
  std::vector<std::string> texts;
  std::size_t at = 0;
  for (const std::size_t size : sizes) {
    texts.push_back(all.substr(at, size));
    at += size;
  }
  return texts;
}

void agree(Ranks& ranks, const std::function<void()>& work) {
  std::optional<Error> own;
  std::exception_ptr thrown;
  try {
    work();
  } catch (const RankLost&) {
    throw;
  } catch (const Error& error) {
    own = error;
    thrown = std::current_exception();
  }
  constexpr int kSound = -1;
  const std::vector<int> kinds = all_of(ranks, own ? static_cast<int>(own->kind()) : kSound);
  std::size_t failed = 0;
  while (failed < kinds.size() && kinds[failed] == kSound) ++failed;
  if (failed == kinds.size()) return;
  const std::vector<std::string> codes = texts_of(ranks, own ? own->code().text() : "");
  const std::vector<std::string> messages = texts_of(ranks, own ? own->message() : "");
  const std::vector<std::string> remedies = texts_of(ranks, own ? own->remedy() : "");
  if (thrown) std::rethrow_exception(thrown);
  const Code code = Code::parse(codes[failed]).value_or(Code("internal.exception"));
  throw Error(static_cast<ErrorKind>(kinds[failed]), code, messages[failed], remedies[failed]);
}

std::pair<std::int64_t, std::int64_t> part_of(std::int64_t count, int rank, int size) {
  return {count * rank / size, count * (rank + 1) / size};
}

}  // namespace semfield
