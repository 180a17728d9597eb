#include "app/serve/http_reader.h"

#include <algorithm>
#include <charconv>

namespace semfield::app {

namespace {

constexpr std::size_t kMostHeadBytes = 16384;
constexpr std::size_t kMostChunkLine = 16;  // hexadecimal digits; extensions are refused
constexpr std::string_view kLineEnd = "\r\n";

char small(char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; }

std::string small_letters(std::string_view text) {
  std::string out(text);
  std::transform(out.begin(), out.end(), out.begin(), small);
  return out;
}

// The characters of a method or a header's name.
bool is_token(std::string_view text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
    const char l = small(c);
    return (l >= 'a' && l <= 'z') || (c >= '0' && c <= '9') ||
           std::string_view("!#$%&'*+-.^_`|~").find(c) != std::string_view::npos;
  });
}

bool is_visible(char c) { return static_cast<unsigned char>(c) > 0x20 && c != 0x7F; }
bool is_text(char c) { return is_visible(c) || c == ' ' || c == '\t'; }

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t')) text.remove_suffix(1);
  return text;
}

bool has_word(std::string_view list, std::string_view word) {
  while (!list.empty()) {
    const std::string_view item = list.substr(0, list.find(','));
    list.remove_prefix(std::min(list.size(), item.size() + 1));
    if (small_letters(trimmed(item)) == word) return true;
  }
  return false;
}

}  // namespace

std::optional<std::string> HttpRequest::header(const std::string& name) const {
  for (const auto& [key, value] : headers) {
    if (key == name) return value;
  }
  return std::nullopt;
}

int HttpRequest::header_count(const std::string& name) const {
  return static_cast<int>(
      std::count_if(headers.begin(), headers.end(), [&](const auto& h) { return h.first == name; }));
}

HttpReader::State HttpReader::refuse(int status, const char* complaint) {
  status_ = status;
  complaint_ = complaint;
  pending_.clear();
  return state_ = State::refused;
}

// Whether what ends at `end` (npos: not yet) with so many bytes is longer than `most`, however its bytes are cut.
bool HttpReader::is_above(std::size_t most, std::size_t end, std::size_t ending) const {
  return end == std::string::npos ? pending_.size() > most + ending - 1 : end > most;
}

HttpReader::State HttpReader::take(std::string_view bytes) {
  if (state_ == State::refused) return state_;
  pending_ += bytes;
  return read();
}

void HttpReader::next() {
  request_ = {};
  state_ = State::head;
  keeps_ = true;
  expects_continue_ = chunked_ = in_chunk_ = false;
  left_ = 0;
  (void)read();
}

HttpReader::State HttpReader::read() {
  if (state_ == State::head) {
    while (pending_.starts_with(kLineEnd)) pending_.erase(0, kLineEnd.size());  // between requests
    const std::size_t end = pending_.find("\r\n\r\n"), bare = pending_.find("\n\n");
    if (is_above(kMostHeadBytes, std::min(end, bare), 4)) return refuse(400, "the head of the request is too long");
    if (bare < end) return refuse(400, "a line of the head does not end as lines of HTTP do");
    if (end == std::string::npos) return state_;
    read_head(end);
  }
  return state_ == State::body ? read_body() : state_;
}

HttpReader::State HttpReader::read_head(std::size_t end) {
  const std::string head = pending_.substr(0, end + kLineEnd.size());
  pending_.erase(0, end + 2 * kLineEnd.size());
  std::string_view rest = head;
  const auto line = [&] {
    const std::string_view text = rest.substr(0, rest.find(kLineEnd));
    rest.remove_prefix(text.size() + kLineEnd.size());
    return text;
  };
  const std::string_view first = line();
  const std::size_t method = first.find(' '), version = first.rfind(' ');
  if (method == std::string_view::npos || version == method) return refuse(400, "the request has no address");
  const std::string_view target = first.substr(method + 1, version - method - 1), http = first.substr(version + 1);
  if (!is_token(first.substr(0, method)) || target.empty() || !std::all_of(target.begin(), target.end(), is_visible))
    return refuse(400, "the first line of the request cannot be read");
  if (http != "HTTP/1.1" && http != "HTTP/1.0") return refuse(400, "the request is not of HTTP/1.1");
  keeps_ = http == "HTTP/1.1";
  request_.method = first.substr(0, method);
  request_.path = target.substr(0, target.find('?'));
  if (request_.path.size() < target.size()) request_.query = target.substr(request_.path.size() + 1);
  while (!rest.empty()) {
    const std::string_view text = line();
    const std::size_t colon = text.find(':');
    if (colon == std::string_view::npos || !is_token(text.substr(0, colon)) ||
        !std::all_of(text.begin(), text.end(), is_text))
      return refuse(400, "a header of the request cannot be read");
    request_.headers.emplace_back(small_letters(text.substr(0, colon)), trimmed(text.substr(colon + 1)));
  }
  return read_framing();
}

HttpReader::State HttpReader::read_framing() {
  const auto lengths = request_.header_count("content-length"), codings = request_.header_count("transfer-encoding");
  if (lengths + codings > 1) return refuse(400, "the request has two lengths");
  for (const auto& [name, value] : request_.headers)
    if (name == "connection" && has_word(value, "close")) keeps_ = false;
  expects_continue_ = small_letters(request_.header("expect").value_or("")) == "100-continue";
  state_ = State::body;
  if (codings > 0) {
    if (small_letters(*request_.header("transfer-encoding")) != "chunked")
      return refuse(400, "the body is encoded in another way than in chunks");
    chunked_ = true;
    return state_;
  }
  return lengths > 0 ? read_length(*request_.header("content-length")) : state_;
}

HttpReader::State HttpReader::read_length(const std::string& text) {
  if (text.empty() || text.find_first_not_of("0123456789") != std::string::npos)
    return refuse(400, "Content-Length is not a number of bytes");
  const auto [end, cause] = std::from_chars(text.data(), text.data() + text.size(), left_);
  if (cause != std::errc() || left_ > most_body_bytes_) return refuse(413, "the body is too large");
  return state_;
}

HttpReader::State HttpReader::read_body() {
  if (chunked_) return read_chunks();
  const std::size_t now = std::min(left_, pending_.size());
  request_.body.append(pending_, 0, now);
  pending_.erase(0, now);
  left_ -= now;
  if (left_ == 0) state_ = State::whole;
  return state_;
}

HttpReader::State HttpReader::read_chunks() {
  for (;;) {
    if (in_chunk_) {
      const std::size_t now = std::min(left_, pending_.size());
      request_.body.append(pending_, 0, now);
      pending_.erase(0, now);
      left_ -= now;
      if (left_ > 0 || pending_.size() < kLineEnd.size()) return state_;
      if (!pending_.starts_with(kLineEnd)) return refuse(400, "a chunk of the body has another length than it says");
      pending_.erase(0, kLineEnd.size());
      in_chunk_ = false;
    }
    const std::size_t end = pending_.find(kLineEnd);
    if (is_above(kMostChunkLine, end, kLineEnd.size())) return refuse(400, "a chunk's length cannot be read");
    if (end == std::string::npos) return state_;
    const auto [digits, cause] = std::from_chars(pending_.data(), pending_.data() + end, left_, 16);
    if (end == 0 || cause != std::errc() || digits != pending_.data() + end)
      return refuse(400, "a chunk's length cannot be read");
    if (left_ > most_body_bytes_ - request_.body.size()) return refuse(413, "the body is too large");
    if (left_ == 0) {  // the last one; headers behind it are refused
      if (pending_.size() < end + 2 * kLineEnd.size()) return state_;
      if (pending_.compare(end, 2 * kLineEnd.size(), "\r\n\r\n") != 0) return refuse(400, "headers follow the body");
      pending_.erase(0, end + 2 * kLineEnd.size());
      return state_ = State::whole;
    }
    pending_.erase(0, end + kLineEnd.size());
    in_chunk_ = true;
  }
}

}  // namespace semfield::app
