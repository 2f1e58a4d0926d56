/* taciturn: the checksum CRC-32, and the keyed hash BLAKE2s. */
#include <string.h>

#include "taciturn_parts.h"

enum { TAG_SIZE = 16, BLOCK_SIZE = 64 };

/* CRC-32 with the polynomial 0x04C11DB7, least significant bit first, four bits at a time. */
uint32_t tac_checksum(uint32_t before, const uint8_t *content, size_t size) {
  static const uint32_t table[16] = {
      0x00000000U, 0x1DB71064U, 0x3B6E20C8U, 0x26D930ACU, 0x76DC4190U, 0x6B6B51F4U, 0x4DB26158U, 0x5005713CU,
      0xEDB88320U, 0xF00F9344U, 0xD6D6A3E8U, 0xCB61B38CU, 0x9B64C2B0U, 0x86D3D2D4U, 0xA00AE278U, 0xBDBDF21CU,
  };
  uint32_t remainder = before ^ 0xFFFFFFFFU;
  for (size_t i = 0U; i < size; i++) {
    remainder ^= content[i];
    remainder = (remainder >> 4U) ^ table[remainder & 15U];
    remainder = (remainder >> 4U) ^ table[remainder & 15U];
  }
  return remainder ^ 0xFFFFFFFFU;
}

static const uint32_t BLAKE_START[8] = {
    0x6A09E667U, 0xBB67AE85U, 0x3C6EF372U, 0xA54FF53AU, 0x510E527FU, 0x9B05688CU, 0x1F83D9ABU, 0x5BE0CD19U,
};

static uint32_t turned_right(uint32_t word, unsigned by) {
  return (word >> by) | (word << (32U - by));
}

/* Mix two words of the message into a column or a diagonal of the BLAKE2s state. */
static void mix(uint32_t *v, unsigned a, unsigned b, unsigned c, unsigned d, uint32_t x, uint32_t y) {
  v[a] += v[b] + x;
  v[d] = turned_right(v[d] ^ v[a], 16U);
  v[c] += v[d];
  v[b] = turned_right(v[b] ^ v[c], 12U);
  v[a] += v[b] + y;
  v[d] = turned_right(v[d] ^ v[a], 8U);
  v[c] += v[d];
  v[b] = turned_right(v[b] ^ v[c], 7U);
}

/* Add a block of the message to the BLAKE2s state; `bytes` is the length of the message up to the end of the block. */
static void compress(uint32_t *state, const uint8_t *block, uint64_t bytes, bool last) {
  static const uint8_t order[10][16] = {
      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}, {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
      {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4}, {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
      {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13}, {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
      {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11}, {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
      {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5}, {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
  };
  uint32_t v[16];
  uint32_t words[16];
  for (unsigned i = 0U; i < 16U; i++) {
    const uint8_t *at = &block[4U * i]; /* little-endian, unlike the packet */
    words[i] = (uint32_t)at[0] | ((uint32_t)at[1] << 8U) | ((uint32_t)at[2] << 16U) | ((uint32_t)at[3] << 24U);
    v[i] = (i < 8U) ? state[i] : BLAKE_START[i - 8U];
  }
  v[12] ^= (uint32_t)(bytes & 0xFFFFFFFFU);
  v[13] ^= (uint32_t)(bytes >> 32U);
  v[14] ^= last ? 0xFFFFFFFFU : 0U;
  for (unsigned round = 0U; round < 10U; round++) {
    const uint8_t *next = order[round];
    for (unsigned i = 0U; i < 4U; i++) {
      mix(v, i, 4U + i, 8U + i, 12U + i, words[next[2U * i]], words[next[(2U * i) + 1U]]);
    }
    for (unsigned i = 0U; i < 4U; i++) {
      mix(v, i, 4U + ((i + 1U) & 3U), 8U + ((i + 2U) & 3U), 12U + ((i + 3U) & 3U), words[next[8U + (2U * i)]],
          words[next[9U + (2U * i)]]);
    }
  }
  for (unsigned i = 0U; i < 8U; i++) {
    state[i] ^= v[i] ^ v[8U + i];
  }
}

void tac_write_tag(tac_key key, const uint8_t *content, size_t size, uint8_t *tag) {
  uint32_t state[8];
  uint8_t block[BLOCK_SIZE] = {0};
  uint64_t bytes = BLOCK_SIZE;
  size_t done = 0U;
  (void)memcpy(state, BLAKE_START, sizeof state);
  state[0] ^= 0x01010000U ^ ((uint32_t)key.size << 8U) ^ (uint32_t)TAG_SIZE;
  state[6] ^= 0x69636174U; /* "taci" */
  state[7] ^= 0x6E727574U; /* "turn" */
  (void)memcpy(block, key.bytes, key.size);
  compress(state, block, bytes, false);
  for (; size - done > (size_t)BLOCK_SIZE; done += (size_t)BLOCK_SIZE) {
    bytes += (uint64_t)BLOCK_SIZE;
    compress(state, &content[done], bytes, false);
  }
  (void)memset(block, 0, sizeof block);
  (void)memcpy(block, &content[done], size - done);
  compress(state, block, bytes + (size - done), true);
  for (unsigned i = 0U; i < (unsigned)TAG_SIZE; i++) {
    tag[i] = (uint8_t)((state[i / 4U] >> (8U * (i % 4U))) & 0xFFU);
  }
}

uint64_t tac_draw(tac_key key, const uint8_t *content, size_t size) {
  uint8_t tag[TAG_SIZE];
  tac_write_tag(key, content, size, tag);
  return tac_get(tag, 8U);
}
