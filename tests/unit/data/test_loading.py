import pytest
import torch

from memcomp_lightning.data import Batches
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.units import Categorical, Mixed, Spin


def numbered(*shape):
    """Images whose only unit is their number within the replica, and whose label says the same."""
    label = torch.arange(shape[-1]).expand(shape).clone()
    replica = torch.arange(label.numel() // shape[-1]).view(*shape[:-1], 1)
    v = torch.stack((label.float(), replica.expand(shape).float()), dim=-1)
    return v, label


def make(*shape, batch_size=None, chunk_size=1000, shuffle=True, seed=0, **settings):
    return Batches(*numbered(*shape), batch_size, chunk_size, shuffle, seed, **settings)


def order(batches):
    return torch.cat([batch.label for batch in batches], dim=-1)


def steps(batches):
    """The chunks of each step."""
    result = [[]]
    for batch in batches:
        result[-1].append(batch)
        if batch.closes_step:
            result.append([])
    assert result.pop() == []
    return result


@pytest.mark.parametrize("shape", [(23,), (3, 23), (2, 3, 23)])
@pytest.mark.parametrize("shuffle", [True, False])
@pytest.mark.parametrize(("batch_size", "chunk_size"), [(None, 1000), (None, 7), (5, 1000), (5, 2), (23, 3)])
def test_every_image_comes_once_with_its_label(shape, shuffle, batch_size, chunk_size):
    batches = make(*shape, batch_size=batch_size, chunk_size=chunk_size, shuffle=shuffle)
    assert len(list(batches)) == len(batches)
    assert order(batches).sort(dim=-1).values.equal(numbered(*shape)[1])
    for batch in batches:
        assert batch.v.shape == (*batch.label.shape, 2)
        assert batch.label.shape[:-1] == shape[:-1]
        assert batch.label.shape[-1] <= chunk_size
        assert batch.v[..., 0].equal(batch.label.float())
        replica = torch.arange(batch.label[..., 0].numel()).view(*shape[:-1], 1)
        assert (batch.v[..., 1] == replica).all()


def test_last_smaller_batch_is_kept():
    sizes = [(len(batch.label), batch.share, batch.closes_step) for batch in make(23, batch_size=5)]
    assert sizes == [(5, 1.0, True)] * 4 + [(3, 1.0, True)]


def test_order_depends_on_seed_and_epoch_alone():
    batches = make(23, batch_size=5)
    first = order(batches)
    assert order(batches).equal(first)
    batches.sampler.set_epoch(1)
    second = order(batches)
    assert not second.equal(first)
    assert not order(make(23, batch_size=5, seed=1)).equal(first)
    resumed = make(23, batch_size=5)
    resumed.set_epoch(1)
    assert order(resumed).equal(second)


def test_pass_continues_where_the_saved_one_was():
    batches = make(3, 23, batch_size=5)
    batches.set_epoch(2)
    whole = list(batches)
    running = iter(batches)
    next(running), next(running)
    resumed = make(3, 23, batch_size=5)
    resumed.load_state_dict(batches.state_dict())
    resumed.set_epoch(2)
    rest = list(resumed)
    assert len(rest) == 3
    assert all(a.v.equal(b.v) for a, b in zip(rest, whole[2:], strict=True))
    assert len(list(resumed)) == 5


def test_saved_position_belongs_to_its_epoch():
    batches = make(23, batch_size=5)
    next(iter(batches))
    resumed = make(23, batch_size=5)
    resumed.load_state_dict(batches.state_dict())
    resumed.set_epoch(1)
    assert len(list(resumed)) == 5


def test_order_is_of_the_epoch_set_before_the_first_batch():
    batches = make(23, batch_size=5)
    running = iter(batches)
    batches.set_epoch(1)
    assert torch.cat([batch.label for batch in running]).equal(order(batches))


def test_order_does_not_depend_on_the_size_of_the_batches():
    assert order(make(23, batch_size=5)).equal(order(make(23, batch_size=11, chunk_size=3)))


def test_replicas_have_their_own_orders():
    first, second, third = order(make(3, 23, batch_size=5))
    assert not first.equal(second)
    assert not second.equal(third)


def test_global_generator_is_left_alone():
    before = torch.get_rng_state()
    order(make(3, 23, batch_size=5))
    assert torch.get_rng_state().equal(before)


@pytest.mark.parametrize("shuffle", [True, False])
def test_whole_set_in_one_chunk_is_not_copied(shuffle):
    v, label = numbered(3, 23)
    (batch,) = Batches(v, label, None, 1000, shuffle, 0)
    assert batch.v.data_ptr() == v.data_ptr()
    assert batch.label.data_ptr() == label.data_ptr()
    assert batch.share == 1
    assert batch.closes_step


def test_unshuffled_chunks_are_views():
    v, label = numbered(1, 23)
    v, label = v.expand(3, -1, -1), label.expand(3, -1)
    storage = v.untyped_storage().data_ptr()
    batches = list(Batches(v, label, None, 7, False, 0))
    assert [batch.label.shape for batch in batches] == [(3, 5), (3, 6), (3, 6), (3, 6)]
    assert all(batch.v.untyped_storage().data_ptr() == storage for batch in batches)


def test_expanded_images_can_be_shuffled():
    v, label = numbered(1, 23)
    batches = Batches(v.expand(3, -1, -1), label.expand(3, -1), 5, 1000, True, 0)
    assert order(batches).equal(order(make(3, 23, batch_size=5)))


@pytest.mark.parametrize("replicas", [(), (3,)])
@pytest.mark.parametrize("world_size", [2, 3])
@pytest.mark.parametrize(("batch_size", "chunk_size"), [(None, 1000), (None, 5), (7, 1000), (11, 2), (7, 3)])
def test_processes_share_each_step(replicas, world_size, batch_size, chunk_size):
    n = 31
    settings = {"batch_size": batch_size, "chunk_size": chunk_size}
    ranks = [steps(make(*replicas, n, **settings, rank=rank, world_size=world_size)) for rank in range(world_size)]
    whole = order(make(*replicas, n, batch_size=batch_size or n))
    if batch_size is None:
        whole = whole.sort(dim=-1).values
    start = 0
    for shards in zip(*ranks, strict=True):
        assert len({len(shard) for shard in shards}) == 1
        chunks = [chunk for shard in shards for chunk in shard]
        assert all(1 <= chunk.label.shape[-1] <= chunk_size for chunk in chunks)
        seen = torch.cat([chunk.label for chunk in chunks], dim=-1)
        n_step = seen.shape[-1]
        step = whole[..., start : start + n_step]
        assert seen.sort(dim=-1).values.equal(step.sort(dim=-1).values)
        mean = sum(chunk.share * chunk.v.mean(dim=-2) for chunk in chunks) / world_size
        torch.testing.assert_close(mean[..., 0], step.float().mean(dim=-1))
        assert sum(chunk.share for chunk in chunks) == pytest.approx(world_size)
        start += n_step
    assert start == n


@pytest.mark.parametrize("rank", [0, 1])
def test_processes_take_every_second_position(rank):
    whole = order(make(22, batch_size=11))
    mine = [batch.label for batch in make(22, batch_size=11, rank=rank, world_size=2)]
    assert mine[0].equal(whole[:11][rank::2])
    assert mine[1].equal(whole[11:][rank::2])


@pytest.mark.parametrize("rank", [0, 1])
def test_step_with_fewer_images_than_processes_is_refused(rank):
    with pytest.raises(SettingError, match=r"batch_size = 11 .*a step has 1 images for 2 processes"):
        make(23, batch_size=11, rank=rank, world_size=2)
    with pytest.raises(SettingError, match=r"batch_size = None .*3 images for 5 processes"):
        make(3, rank=0, world_size=5)


def test_chunks_of_one_image_need_an_even_step():
    assert len(make(22, chunk_size=1, world_size=2)) == 11
    with pytest.raises(SettingError, match=r"chunk_size = 1 .*>= 2.*2 processes share a step of 23"):
        make(23, chunk_size=1, world_size=2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 0}, r"batch_size = 0 "),
        ({"chunk_size": 0}, r"chunk_size = 0 "),
        ({"seed": -1}, r"seed = -1 "),
        ({"world_size": 0}, r"world_size = 0 "),
        ({"rank": 2, "world_size": 2}, r"rank = 2 .*from 0 to 1"),
        ({"rank": -1}, r"rank = -1 "),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        make(23, **settings)


def test_tensors_that_do_not_fit_are_refused():
    v, label = numbered(23)
    with pytest.raises(SettingError, match=r"label.shape = \(22,\) .*\(23,\)"):
        Batches(v, label[1:], None, 5, True, 0)
    with pytest.raises(SettingError, match=r"v.shape = \(0, 2\)"):
        Batches(v[:0], label[:0], None, 5, True, 0)


def test_negative_epoch_is_refused():
    with pytest.raises(SettingError, match="epoch = -1"):
        make(23).set_epoch(-1)


def test_values_that_the_units_do_not_take_are_refused_by_their_place(monkeypatch):
    """Also where the rows are looked at in parts, and not where they are missing."""
    monkeypatch.setattr("memcomp_lightning.data.loading._ENTRIES_CHECKED", 2 * 7)
    units = Mixed(Categorical([3, 2]), Spin(2))
    v = torch.tensor([[0.0, 1, 1, -1]]).repeat(9, 1)
    Batches(v, torch.zeros(9).long(), 3, chunk_size=3, shuffle=True, seed=0, units=units)
    for row, column, value in ((0, 1, 2.0), (5, 0, 0.5), (8, 3, 0.0), (7, 2, 3.0)):
        wrong = v.clone()
        wrong[row, column] = value
        settings = {"batch_size": 3, "chunk_size": 3, "shuffle": True, "seed": 0, "units": units}
        if value:  # of spins 0 is a mean
            with pytest.raises(SettingError, match=rf"column {column}, row {row} = {value}"):
                Batches(wrong, torch.zeros(9).long(), **settings)
        observed = torch.ones_like(v, dtype=torch.bool)
        observed[row, column] = False
        Batches(wrong, torch.zeros(9).long(), **settings, observed=observed)
